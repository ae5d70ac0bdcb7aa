"""Run `python -m benchmarks.corpus`."""

from benchmarks.corpus.command import main

if __name__ == "__main__":
    main()
