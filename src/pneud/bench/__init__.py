"""How punctual the loop is on this machine, beside references that take turns with it."""
