"""The two commands; they parse, call one library function, and print."""
