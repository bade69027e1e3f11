"""What does one event say?  From a candidate to its row, with errors and bounds."""
