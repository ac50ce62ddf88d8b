"""Pictures and animations of interactions and of imagined effects."""
