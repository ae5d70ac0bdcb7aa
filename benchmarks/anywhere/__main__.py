"""Run `python -m benchmarks.anywhere`."""

from benchmarks.anywhere.image import main

if __name__ == "__main__":
    main()
