# SPDX-License-Identifier: Apache-2.0
# The command in an image, with the pinned packages.  `--build-arg VIEWER=no` halves it: no recordings.
FROM python:3.12-slim
ARG VIEWER=yes
WORKDIR /srv/abyssnav
COPY .ci/requirements.txt ./requirements.txt
COPY pyproject.toml README.md LICENSE ./
COPY schemas ./schemas
COPY pipeline ./pipeline
RUN if [ "$VIEWER" = no ]; then sed -i '/^rerun-sdk==/,/^    # via/d' requirements.txt; fi
RUN python -m pip install --no-cache-dir --no-deps --require-hashes -r requirements.txt
RUN python -m pip install --no-cache-dir --no-deps --no-build-isolation .
USER 1000
WORKDIR /data
ENTRYPOINT ["abyssnav"]
