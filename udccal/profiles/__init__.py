"""The versioned rig profile: schema, reading and writing."""
