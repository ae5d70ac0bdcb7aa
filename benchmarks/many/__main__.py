"""Run `python -m benchmarks.many`."""

from benchmarks.many.graphs import main

if __name__ == "__main__":
    main()
