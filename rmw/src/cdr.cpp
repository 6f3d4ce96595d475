// SPDX-License-Identifier: MIT OR Apache-2.0
// The Fast CDR callbacks that rosidl generates for each type, callable from Rust: no exception leaves this file. Bodies are
// CDR without the four bytes of encapsulation, little-endian, as they lie in shared memory.

#include <cstdint>
#include <cstring>
#include <exception>

#include <fastcdr/Cdr.h>
#include <fastcdr/config.h>
#include <fastcdr/FastBuffer.h>
#include <rosidl_typesupport_fastrtps_cpp/message_type_support.h>

namespace
{
using eprosima::fastcdr::Cdr;
using eprosima::fastcdr::FastBuffer;

const message_type_support_callbacks_t & of(const void * callbacks)
{
  return *static_cast<const message_type_support_callbacks_t *>(callbacks);
}

// Runs `body`, which returns whether it succeeded; the text of an exception is written to `reason`.
template<typename Body>
bool guarded(char * reason, size_t reason_bytes, Body body) noexcept
{
  const char * text = "its type support refused it";
  try {
    if (body()) {
      return true;
    }
  } catch (const std::exception & error) {
    std::strncpy(reason, error.what(), reason_bytes - 1);
    return false;
  } catch (...) {
    text = "its type support threw an unknown exception";
  }
  std::strncpy(reason, text, reason_bytes - 1);
  return false;
}

// Plain CDR over a buffer.
struct Plain
{
  FastBuffer buffer;
  Cdr cdr;

#if FASTCDR_VERSION_MAJOR < 2
  Plain(char * bytes, size_t size, bool is_little)
  : buffer(bytes, size), cdr(buffer, is_little ? Cdr::LITTLE_ENDIANNESS : Cdr::BIG_ENDIANNESS, Cdr::DDS_CDR)
  {
  }

  size_t written() const
  {
    return cdr.getSerializedDataLength();
  }
#else
  Plain(char * bytes, size_t size, bool is_little)
  : buffer(bytes, size), cdr(
      buffer, is_little ? Cdr::LITTLE_ENDIANNESS : Cdr::BIG_ENDIANNESS, eprosima::fastcdr::CdrVersion::XCDRv1)
  {
    cdr.set_encoding_flag(eprosima::fastcdr::EncodingAlgorithmFlag::PLAIN_CDR);
  }

  size_t written() const
  {
    return cdr.get_serialized_data_length();
  }
#endif
};
}  // namespace

extern "C"
{
// The longest body of a type, and whether it is bounded: `bounds` as in rosidl_typesupport_fastrtps_cpp.
size_t taut_cdr_longest(const void * callbacks, uint8_t * bounds) noexcept
{
  char said = 0;
  const size_t longest = of(callbacks).max_serialized_size(said);
  *bounds = static_cast<uint8_t>(said);
  return longest;
}

// Upper bound of the length of a message's body.
bool taut_cdr_estimate(
  const void * callbacks, const void * message, size_t * estimate, char * reason, size_t reason_bytes) noexcept
{
  return guarded(
    reason, reason_bytes, [&] {
      *estimate = of(callbacks).get_serialized_size(message);
      return true;
    });
}

bool taut_cdr_write(
  const void * callbacks, const void * message, uint8_t * to, size_t capacity, size_t * written, char * reason,
  size_t reason_bytes) noexcept
{
  return guarded(
    reason, reason_bytes, [&] {
      Plain body(reinterpret_cast<char *>(to), capacity, true);
      const bool is_written = of(callbacks).cdr_serialize(message, body.cdr);
      *written = body.written();
      return is_written;
    });
}

bool taut_cdr_read(
  const void * callbacks, const uint8_t * from, size_t size, bool is_little, void * message, char * reason,
  size_t reason_bytes) noexcept
{
  return guarded(
    reason, reason_bytes, [&] {
      // Only read.
      Plain body(const_cast<char *>(reinterpret_cast<const char *>(from)), size, is_little);
      return of(callbacks).cdr_deserialize(body.cdr, message);
    });
}
}
