"""The thesis's tables and figures of chapters 3 and 4, each by one command: `swarmnet reproduce NAME`."""

from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment, find

__all__ = ["Cell", "DataSet", "Effort", "Experiment", "find"]
