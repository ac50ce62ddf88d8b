"""Lever-ups in a physics engine: scene, arm, tool, camera, what happened, and many of them at once."""
