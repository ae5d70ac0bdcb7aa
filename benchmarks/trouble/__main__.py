"""Run `python -m benchmarks.trouble`."""

from benchmarks.trouble.command import main

if __name__ == "__main__":
    main()
