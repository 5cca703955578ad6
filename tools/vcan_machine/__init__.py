"""The vcan test machine: a Debian kernel under QEMU, for machines whose own kernel has no CAN.

The guest has no disk image. Its root is the host's file tree, read-only, under a layer in memory; the one folder it
writes to is the one for results.
"""
