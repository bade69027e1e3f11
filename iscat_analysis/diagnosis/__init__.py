"""What is special about this movie?  Its light, noise, kind, and what went wrong."""
