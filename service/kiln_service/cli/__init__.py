"""The `lightkiln` command: bake on this machine, or talk to a coordinator anywhere."""
