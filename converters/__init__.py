"""Raw scan + CAD models + alignments in, scene folder (`scene.xml`, `scene.json`, `maps.npz`, `assets/`) out.

Files are touched by the readers and by the writer only; every stage between is a function of arrays.
The order of the stages is in `pipeline.py`.
"""
