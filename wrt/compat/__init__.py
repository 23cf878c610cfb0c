"""Other libraries' ray classes, answered by wrt: change one import, keep the program. Nothing of wrt imports this."""
