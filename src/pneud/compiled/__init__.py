"""Law, checks and plant in C: made from the very Python functions, the same to the last bit.

`pure2c` translates and compiles them once, into the user's cache; before every run they are compared with
Python. Without a compiler everything works as well, only slower.
"""
