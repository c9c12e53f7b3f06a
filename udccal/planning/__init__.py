"""How much to capture: what planned frames will tell, by their Fisher information, before any is taken."""
