"""Layouts that renderers read as they are: `uncompressed` and `spark` in .gspk files, and `gscc`, Unity's cache."""
