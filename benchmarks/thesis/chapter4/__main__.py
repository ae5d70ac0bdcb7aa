"""Run `python -m benchmarks.thesis.chapter4`."""

from benchmarks.thesis.chapter4.command import main

if __name__ == "__main__":
    main()
