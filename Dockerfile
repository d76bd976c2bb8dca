FROM python:3.11-slim-bookworm
RUN apt-get update \
 && apt-get install -y --no-install-recommends make libegl1 libegl-mesa0 libgles2 libgl1-mesa-dri \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /onedemo
COPY . .
RUN make setup
# Every address of the container: which of this machine lead there is said where it is started
# (docker-compose.yml: the loopback). Put a proxy with TLS before it to open it further.
ENV HOST=0.0.0.0 PORT=8080 DATA_DIR=/data OPTIONS=--behind-proxy
VOLUME /data
EXPOSE 8080
CMD ["make", "run"]
