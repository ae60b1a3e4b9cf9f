"""Datasets on disk: loaders, builders and checks. Numpy in, numpy out: nothing here knows of learning."""
