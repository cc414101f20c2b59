"""The laws: the sliding one of the paper (composite and ISMC), and those of the slot beside it."""
