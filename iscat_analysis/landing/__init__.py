"""Which particles land and leave?  Windows before and after each step."""
