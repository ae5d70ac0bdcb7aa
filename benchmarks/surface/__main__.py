"""Run `python -m benchmarks.surface`."""

from benchmarks.surface.command import main

if __name__ == "__main__":
    main()
