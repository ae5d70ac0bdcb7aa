"""Run `python -m benchmarks.hundred`."""

from benchmarks.hundred.command import main

if __name__ == "__main__":
    main()
