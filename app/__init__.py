"""The movie in the browser, for those who do not program: `iscat app`.

Installed as `iscat_app`.  `server` starts it, `page` puts the parts together, and each part has a
file: `files`, `film`, `form`, `runs`, `results`, `compare`, `calibrate`, `bounds`.  Whatever is
computed is asked of `iscat_analysis`, by the same calls as on the command line.
"""
