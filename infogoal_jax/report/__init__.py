"""Tables and figures, made from what a run left on disk."""
