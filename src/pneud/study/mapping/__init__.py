"""What is on a bus beside a DBC: frames in, a description and a guess at the mapping out."""
