"""Arrays to small integers and back; every codec states its largest error."""
