"""Learning from reward: rollouts, advantages, PPO. It knows neither MuJoCo nor motion."""
