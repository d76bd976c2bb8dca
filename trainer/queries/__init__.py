"""Which clips are put to an annotator. Pure functions on arrays."""
