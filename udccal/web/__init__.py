"""A guided capture as a page: who is led sits before a browser on this computer."""
