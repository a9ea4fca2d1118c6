"""What defines a capture: its files, its manifest, its lenses."""
