"""How do particles move?  Frames, links, tracks and their background."""
