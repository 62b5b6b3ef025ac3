"""`swarmnet report`."""

from swarmnet.config import Report
from swarmnet.report import write_report


def run(config: Report) -> int:
    """Writes the report anew."""
    print(write_report(config.run))
    return 0
