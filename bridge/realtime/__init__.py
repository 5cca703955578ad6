"""Real time: every station a process of its own, on SocketCAN or on the hub."""
