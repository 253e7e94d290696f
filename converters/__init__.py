"""Convert a raw scan, CAD models and alignments to a scene folder; `pipeline.py` has the order of the stages."""
