"""Results as files that other programs open: RTI viewers and renderers."""
