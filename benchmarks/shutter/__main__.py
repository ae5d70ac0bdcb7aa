"""Run `python -m benchmarks.shutter`."""

from benchmarks.shutter.command import main

if __name__ == "__main__":
    main()
