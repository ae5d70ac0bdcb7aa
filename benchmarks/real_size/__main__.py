"""Run `python -m benchmarks.real_size`."""

from benchmarks.real_size.command import main

if __name__ == "__main__":
    main()
