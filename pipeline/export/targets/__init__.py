"""What a model is exported to: a `Target` in a module of this folder is found by being there."""
