"""The native engine on a CPU: how it is built, found, called, and what it reads. It needs no torch to be built."""
