"""Draw near goals first, and farther ones once episodes succeed: a curriculum for batches that reset themselves."""

import flax.struct
import jax
import jax.numpy as jnp

GROWTH = 1.5
"""Factor of the largest distance at each advance."""


@flax.struct.dataclass
class Curriculum:
    """Hold the progress of N environments as arrays [N], like the rest of a batch's state, and two settings."""

    limit_m: jax.Array
    """Largest length of the path from start to goal of new episodes, the same for all."""
    drawn_m: jax.Array
    """The limit when each environment's episode was drawn."""
    success: jax.Array
    """Average success of episodes that were drawn under the present limit, the same for all."""
    full_m: float = flax.struct.field(pytree_node=False)
    """From this limit on, episodes are drawn without one."""
    needed_success: float = flax.struct.field(pytree_node=False)
    """The average at which the limit grows."""

    @property
    def allowed_m(self) -> jax.Array:
        """Return [N] m: the largest distance of episodes that are drawn now; infinite: any."""
        return jnp.where(self.limit_m >= self.full_m, jnp.inf, self.limit_m)

    def after(self, done: jax.Array, success: jax.Array) -> "Curriculum":
        """Return what follows a step that ended episodes [N] bool, with success [N] where it did.

        The average is exponential, over about N episodes, and starts at 0 for each limit.
        """
        counted = done & (self.drawn_m == self.limit_m)
        number = jnp.sum(counted)
        mean = jnp.sum(jnp.where(counted, success, 0.0)) / jnp.maximum(number, 1)
        average = self.success + (1.0 - (1.0 - 1.0 / len(done)) ** number) * (mean - self.success)
        grows = (average >= self.needed_success) & (self.limit_m < self.full_m)
        limit_m = jnp.where(grows, jnp.minimum(GROWTH * self.limit_m, self.full_m), self.limit_m)
        new = {"drawn_m": jnp.where(done, limit_m, self.drawn_m), "success": jnp.where(grows, 0.0, average)}
        return self.replace(limit_m=limit_m, **new)  # type: ignore[attr-defined]
