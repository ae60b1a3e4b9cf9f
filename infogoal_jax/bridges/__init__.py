"""Other libraries' interfaces to our environments: Gymnasium and brax."""
