"""Relabelling in hindsight, a file a method."""
