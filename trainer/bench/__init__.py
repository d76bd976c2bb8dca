"""Measurements: what the program costs beside its peers and the machine's limit. Peers: extra ``[bench]``."""
