"""One cell: what decides its outcome lives here, and is hashed together."""
