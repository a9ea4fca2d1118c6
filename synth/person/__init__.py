"""The person: body, clothes, texture at rest."""
