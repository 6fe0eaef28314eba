"""The mathematics of one attribute, in numpy, knowing no cloud and no file."""
