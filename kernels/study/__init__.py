"""Kernels that only the laboratory (wrt.lab) uses: measurements, and code to compare wrt with."""
