"""From a box of parts to an axis that works."""
