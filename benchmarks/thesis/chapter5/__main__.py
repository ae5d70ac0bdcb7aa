"""Run `python -m benchmarks.thesis.chapter5`."""

from benchmarks.thesis.chapter5.command import main

if __name__ == "__main__":
    main()
