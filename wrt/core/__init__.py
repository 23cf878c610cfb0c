"""What all of wrt stands on: errors, checks of arguments, files, memory, interrupts, the device, arrays to and from others."""
