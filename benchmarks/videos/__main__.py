"""Run `python -m benchmarks.videos`."""

from benchmarks.videos.command import main

if __name__ == "__main__":
    main()
