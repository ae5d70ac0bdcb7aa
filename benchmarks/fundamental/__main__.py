"""Run `python -m benchmarks.fundamental`."""

from benchmarks.fundamental.command import main

if __name__ == "__main__":
    main()
