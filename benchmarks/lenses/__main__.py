"""Run `python -m benchmarks.lenses`."""

from benchmarks.lenses.command import main

if __name__ == "__main__":
    main()
