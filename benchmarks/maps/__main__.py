"""Run `python -m benchmarks.maps`."""

from benchmarks.maps.command import main

if __name__ == "__main__":
    main()
