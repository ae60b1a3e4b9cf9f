"""The sizes of a house that is built in a moment."""

TINY = {"node_spacing": 1.2, "image_width": 64}
"""Images of 64 x 36 pixels, nodes 1.2 m apart."""
