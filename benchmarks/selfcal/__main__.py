"""Run `python -m benchmarks.selfcal`."""

from benchmarks.selfcal.command import main

if __name__ == "__main__":
    main()
