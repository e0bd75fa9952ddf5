"""torch_ecc."""
