"""What a model is exported to, one file each: it is found by being there and holds one `TARGET`."""
