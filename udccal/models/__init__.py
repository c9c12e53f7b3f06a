"""The five terms as pure JAX functions of small immutable parameter objects, and their composition."""
