#!/usr/bin/env bash
# Makes certificates for a mesh to try things with: an authority, and a key and a certificate for
# each name. The name is what access control knows the owner by.
#
#   certificates.sh DIRECTORY NAME...
#   certificates.sh certificates router robot01 base reader
#
# Names that begin with router are for machines that listen; nobody else can pass for one.
# ROUTER_NAMES says how those are reached, as in ROUTER_NAMES=DNS:base.example.org,IP:192.168.1.5
# (otherwise on this machine alone).
#
# An authority that is there already signs again, so that a robot can be added later. Its key,
# authority.key, belongs on no robot: whoever has it lets in whom they like.
set -euo pipefail
if [ "$#" -lt 2 ]; then
  sed -n '2,/^set/{/^set/!s/^# \{0,1\}//p}' "${BASH_SOURCE[0]}" >&2
  exit 2
fi
directory=$1
shift
days=825
router_names=${ROUTER_NAMES:-DNS:localhost,IP:127.0.0.1}
umask 077
mkdir -p "$directory"
cd "$directory"

new_key() {
  openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$1" 2>/dev/null
}

extensions() {
  case $1 in
    router*) printf 'subjectAltName=%s\nextendedKeyUsage=serverAuth,clientAuth\n' "$router_names" ;;
    *) printf 'subjectAltName=DNS:%s\nextendedKeyUsage=clientAuth\n' "$1" ;;
  esac
}

if [ ! -e authority.pem ]; then
  new_key authority.key
  openssl req -x509 -new -key authority.key -days "$days" -subj "/CN=authority" \
    -addext "keyUsage=critical,keyCertSign,cRLSign" -out authority.pem
fi
for name in "$@"; do
  if [ -e "$name.pem" ]; then
    echo "$directory/$name.pem is there already and is left as it is" >&2
    continue
  fi
  new_key "$name.key"
  openssl req -new -key "$name.key" -subj "/CN=$name" -out "$name.csr"
  openssl x509 -req -in "$name.csr" -CA authority.pem -CAkey authority.key -CAcreateserial \
    -days "$days" -extfile <(extensions "$name") -out "$name.pem" 2>/dev/null
  rm "$name.csr"
  echo "$directory/$name.pem"
done
