"""How much to capture: the sigma that planned frames will give, predicted from their Fisher information."""
