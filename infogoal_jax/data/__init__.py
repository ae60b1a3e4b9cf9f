"""Datasets on disk: readers, writers and checks. Numpy in, numpy out: nothing here knows of learning."""
