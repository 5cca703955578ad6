"""The CAN messages of the bench: DBC files, the C codec generated from them, and its Python binding."""
