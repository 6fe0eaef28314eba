"""The answers that GPU implementations are compared with: sorting, rasterizing, image metrics."""
