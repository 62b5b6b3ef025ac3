"""The front door: command line, experiments, report."""
