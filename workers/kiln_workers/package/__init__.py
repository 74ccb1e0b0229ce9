"""Writing a package from plain arrays: texture arrays, maps, GLB, shaders, report and manifest (docs/package.md)."""
