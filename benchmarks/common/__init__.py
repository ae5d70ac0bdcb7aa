"""What several benchmarks need: result files, figures, metrics, photo sets, processes."""
