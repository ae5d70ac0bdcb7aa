"""Run `python -m benchmarks.cameras`."""

from benchmarks.cameras.command import main

if __name__ == "__main__":
    main()
