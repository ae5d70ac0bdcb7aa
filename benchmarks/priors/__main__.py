"""Run `python -m benchmarks.priors`."""

from benchmarks.priors.command import main

if __name__ == "__main__":
    main()
