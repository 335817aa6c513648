"""One step of the same body in other simulators: `python -m benchmarks.peers --help`."""
