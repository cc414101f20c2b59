"""CAN frames in and out: codecs, links, the virtual bus."""
