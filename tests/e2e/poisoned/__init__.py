"""The stages of a bake, of which one tile kills whoever renders it."""
