"""Experiments over library calls, one module per group of figures; only the command line imports them."""
