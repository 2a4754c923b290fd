"""What speaks to a device: bytes and frames in, measurements out. Imports nothing of fusiond."""
