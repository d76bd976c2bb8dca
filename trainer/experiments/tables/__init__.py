"""The tables of the paper and ours: which jobs, and what is reported of them."""
