"""A page that shows splat files in a browser: served on loopback, or as one file that works offline."""
