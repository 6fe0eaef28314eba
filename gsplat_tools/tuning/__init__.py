"""What a choice of settings costs and buys: measured, searched, and left out where a scene does not need it."""
