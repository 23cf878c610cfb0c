"""Foundations of wrt: errors, checks of arguments, files, threads, interrupts, devices, arrays shared with other libraries."""
