"""Export targets: a `Target` in a module of this folder is discovered automatically."""
