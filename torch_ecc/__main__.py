"""``python -m torch_ecc``: the command line."""

from torch_ecc.cli import main

main()
