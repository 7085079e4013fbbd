"""Renderers: a Table becomes terminal text, CSV or JSON. Nothing here computes."""
