"""The world: batched physics, observations, rewards, resets and tasks. It knows no network."""
