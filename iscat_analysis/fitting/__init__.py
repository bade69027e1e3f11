"""What does one event say?  From a candidate to its row, with errors and bounds."""

from iscat_analysis.fitting.context import AnalysisContext

__all__ = ["AnalysisContext"]
