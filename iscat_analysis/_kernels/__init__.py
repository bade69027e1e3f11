"""Arrays in, arrays out: the compiled inner loops and the tables they run on."""
