"""The template mesh: motion, deformation and skinning (Stg.1)."""
