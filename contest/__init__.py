"""Other people's estimators beside ours, on the same counts; from public names of the library.

`estimators` says which there are, `process` runs each in a process of its own, `compare` lets all
see the same counts, `challenge` writes movies whose truth is withheld, `results` reads the tables
of any program, `scoring` scores them, and `benchmark` is all of it for one configuration.
"""
