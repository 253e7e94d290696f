"""Stages' results in, the files of a scene folder out."""
