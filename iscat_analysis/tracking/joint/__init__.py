"""The joint likelihood of moving particles and the background that they share."""
