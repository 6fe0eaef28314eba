"""Cloud to new cloud; never in place."""
