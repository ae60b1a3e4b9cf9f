"""Generated data that stand in for data which cannot be shipped: the house, the cube, the shelf, and crops of
photographs for backgrounds."""
