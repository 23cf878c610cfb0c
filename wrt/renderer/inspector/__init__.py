"""The ray inspector: every ray of a pixel as a tree that can be printed, drawn and summed."""
