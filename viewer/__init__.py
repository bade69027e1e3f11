"""The napari plugin: movies and results as layers, and the search as it would see these frames.

`readers` makes layers of files, `explorer` is the widget.  Both ask `iscat_analysis` for whatever
is computed.  Installed as `iscat_napari`; `napari.yaml` tells napari what there is.
"""
