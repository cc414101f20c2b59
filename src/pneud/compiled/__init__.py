"""Law, checks and plant in C: made from the very Python functions, the same to the last bit.

The C is translated (`to_c`), wrapped so that it takes and gives the same records (`extension`), compiled once
with the system's compiler into the user's cache (`build`), and compared with Python before every run (`law`).
Without a compiler everything works as well, only slower.
"""
