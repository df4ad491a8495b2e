// Calls functions of the native library as XLA does, without XLA.
#pragma once

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "xla/ffi/api/ffi.h"

struct XLA_FFI_Error {
  std::string message;
};

// What a handler sees as its context: threads that are started one a task.
struct XLA_FFI_ExecutionContext {
  int64_t threads;
  std::vector<std::thread> started;
};

inline const XLA_FFI_Api& fake_api() {
  static const XLA_FFI_Api api = [] {
    XLA_FFI_Api api{};
    api.struct_size = XLA_FFI_Api_STRUCT_SIZE;
    api.api_version = {XLA_FFI_Api_Version_STRUCT_SIZE, nullptr, XLA_FFI_API_MAJOR, XLA_FFI_API_MINOR};
    api.XLA_FFI_Error_Create = [](XLA_FFI_Error_Create_Args* args) { return new XLA_FFI_Error{args->message}; };
    api.XLA_FFI_Error_GetMessage = [](XLA_FFI_Error_GetMessage_Args* args) {
      args->message = args->error->message.c_str();
    };
    api.XLA_FFI_Error_Destroy = [](XLA_FFI_Error_Destroy_Args* args) { delete args->error; };
    api.XLA_FFI_ThreadPool_NumThreads = [](XLA_FFI_ThreadPool_NumThreads_Args* args) -> XLA_FFI_Error* {
      *args->num_threads = args->ctx->threads;
      return nullptr;
    };
    api.XLA_FFI_ThreadPool_Schedule = [](XLA_FFI_ThreadPool_Schedule_Args* args) -> XLA_FFI_Error* {
      args->ctx->started.emplace_back(args->task, args->data);
      return nullptr;
    };
    return api;
  }();
  return api;
}

// An array on the heap, of exactly its size.
template <typename T>
struct Array {
  std::vector<int64_t> dims;
  size_t size = 1;
  std::unique_ptr<T[]> data;

  explicit Array(std::vector<int64_t> dims) : dims(std::move(dims)) {
    for (int64_t dim : this->dims) size *= dim;
    data.reset(new T[size]);
  }
};

inline XLA_FFI_DataType type_of(const float*) { return XLA_FFI_DataType_F32; }
inline XLA_FFI_DataType type_of(const int32_t*) { return XLA_FFI_DataType_S32; }
inline XLA_FFI_DataType type_of(const uint32_t*) { return XLA_FFI_DataType_U32; }
inline XLA_FFI_DataType type_of(const int64_t*) { return XLA_FFI_DataType_S64; }
inline XLA_FFI_DataType type_of(const int8_t*) { return XLA_FFI_DataType_S8; }
inline XLA_FFI_DataType type_of(const uint8_t*) { return XLA_FFI_DataType_U8; }
inline XLA_FFI_DataType type_of(const bool*) { return XLA_FFI_DataType_PRED; }

// Arguments, results and attributes of one call.
class Call {
 public:
  template <typename T>
  Call& arg(Array<T>& array) {
    args_.push_back(buffer(array));
    return *this;
  }
  template <typename T>
  Call& ret(Array<T>& array) {
    rets_.push_back(buffer(array));
    return *this;
  }
  template <typename T>
  Call& attr(const std::string& name, T value) {
    auto& kept = attrs_[name];  // in the order of names, as XLA has them
    kept.value = std::make_shared<T>(value);
    kept.scalar = {type_of(static_cast<T*>(kept.value.get())), kept.value.get()};
    kept.name = {nullptr, name.size()};
    return *this;
  }
  template <typename T>
  Call& attr(const std::string& name, const std::vector<T>& values) {
    auto& kept = attrs_[name];
    auto own = std::make_shared<std::vector<T>>(values);
    kept.value = own;
    kept.array = {type_of(own->data()), own->size(), own->data()};
    kept.name = {nullptr, name.size()};
    kept.type = XLA_FFI_AttrType_ARRAY;
    return *this;
  }

  // Returns what is wrong with the arguments, or nothing.
  std::string run(XLA_FFI_Handler* handler, int threads) {
    std::vector<XLA_FFI_ArgType> arg_types(args_.size(), XLA_FFI_ArgType_BUFFER);
    std::vector<XLA_FFI_RetType> ret_types(rets_.size(), XLA_FFI_RetType_BUFFER);
    std::vector<XLA_FFI_AttrType> attr_types;
    std::vector<void*> args, rets, attrs;
    std::vector<XLA_FFI_ByteSpan*> names;
    for (auto& one : args_) args.push_back(&one);
    for (auto& one : rets_) rets.push_back(&one);
    for (auto& [name, kept] : attrs_) {
      kept.name.ptr = name.data();
      names.push_back(&kept.name);
      attr_types.push_back(kept.type);
      attrs.push_back(kept.type == XLA_FFI_AttrType_ARRAY ? static_cast<void*>(&kept.array) : &kept.scalar);
    }
    XLA_FFI_ExecutionContext context{threads, {}};
    XLA_FFI_CallFrame frame{};
    frame.struct_size = XLA_FFI_CallFrame_STRUCT_SIZE;
    frame.api = &fake_api();
    frame.ctx = &context;
    frame.stage = XLA_FFI_ExecutionStage_EXECUTE;
    const auto count = [](const auto& all) { return static_cast<int64_t>(all.size()); };
    frame.args = {XLA_FFI_Args_STRUCT_SIZE, nullptr, count(args), arg_types.data(), args.data()};
    frame.rets = {XLA_FFI_Rets_STRUCT_SIZE, nullptr, count(rets), ret_types.data(), rets.data()};
    frame.attrs = {XLA_FFI_Attrs_STRUCT_SIZE, nullptr, count(attrs), attr_types.data(), names.data(), attrs.data()};
    std::unique_ptr<XLA_FFI_Error> error(handler(&frame));
    for (auto& thread : context.started) thread.join();
    return error ? error->message : "";
  }

 private:
  struct Attribute {
    std::shared_ptr<void> value;
    XLA_FFI_Scalar scalar;
    XLA_FFI_Array array;
    XLA_FFI_ByteSpan name;
    XLA_FFI_AttrType type = XLA_FFI_AttrType_SCALAR;
  };

  template <typename T>
  static XLA_FFI_Buffer buffer(Array<T>& array) {
    return {XLA_FFI_Buffer_STRUCT_SIZE,  nullptr, type_of(array.data.get()), array.data.get(),
            static_cast<int64_t>(array.dims.size()), array.dims.data()};
  }

  std::vector<XLA_FFI_Buffer> args_, rets_;
  std::map<std::string, Attribute> attrs_;
};
