"""A log as figures, tables and one page."""
