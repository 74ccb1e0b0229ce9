"""The light-field paper's comparisons (tables 1 to 3, figures 6 to 8) on a bake's own stored light fields."""
