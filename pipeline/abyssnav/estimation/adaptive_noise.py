# SPDX-License-Identifier: Apache-2.0
"""How noisy each beacon's times are, where they are noisier than stated: far away, in bad water."""

_MEMORY = 40  #: accepted replies of a beacon over which its noise is averaged
_NOTABLE = 1.5  #: chance alone makes a variance this much larger once in a hundred times
_MOST = 25.0
_LIKELY = 9.21  #: ν² / S beyond which no noise speaks, whatever a filter took in


class Noise:
    """Variance of each beacon's times, learned from the innovations that were accepted.

        m <- m + ((ν² - H P Hᵀ) / σ_t² - m) / 40,    R = m σ_t² where m > 1.5, else σ_t²

    Never less than stated; and nothing is learned while the filter knows less than the time tells.
    """

    def __init__(self, n_beacons: int, sigma_s: float) -> None:
        self._stated_s2, self._ratio = sigma_s**2, [1.0] * n_beacons

    def variance_s2(self, beacon: int) -> float:
        """R of a beacon's next time."""
        ratio = self._ratio[beacon]
        return self._stated_s2 * ratio if ratio > _NOTABLE else self._stated_s2

    def learn(self, beacon: int, innovation_s: float, variance_s2: float) -> None:
        """Take in an accepted innovation and its variance S = H P Hᵀ + R."""
        noise_s2 = self.variance_s2(beacon)
        if variance_s2 <= 2 * noise_s2 and innovation_s**2 <= _LIKELY * variance_s2:
            ratio = (innovation_s**2 - variance_s2 + noise_s2) / self._stated_s2
            mean = self._ratio[beacon] + (ratio - self._ratio[beacon]) / _MEMORY
            self._ratio[beacon] = min(mean, _MOST)
