"""Many scenes and long sequences: the same bytes as on one machine, from as many as there are."""
