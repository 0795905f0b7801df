/* The part of ONNX Runtime's C interface that is used here; the wheel has the library, no header.
 *
 * The interface is a table of functions that only ever grows at its end, so what has a place keeps
 * it: these are the places of version 11, which every later library hands out. */
#ifndef ORT_H
#define ORT_H

#include <stddef.h>
#include <stdint.h>

typedef struct OrtStatus OrtStatus; /* NULL: all is well */
typedef struct OrtEnv OrtEnv;
typedef struct OrtSession OrtSession;
typedef struct OrtSessionOptions OrtSessionOptions;
typedef struct OrtRunOptions OrtRunOptions;
typedef struct OrtMemoryInfo OrtMemoryInfo;
typedef struct OrtValue OrtValue;

enum { ORT_API_VERSION = 11, ORT_LOG_FATAL = 4, ORT_DEVICE_ALLOCATOR = 0, ORT_MEMORY_DEFAULT = 0 };
enum { ORT_FLOAT = 1, ORT_BOOL = 9, ORT_DOUBLE = 11 }; /* ONNX TensorProto.DataType */

typedef void (*OrtUnused)(void);

typedef struct OrtApi {
    OrtUnused unused_0[2];
    const char *(*GetErrorMessage)(const OrtStatus *status);
    OrtStatus *(*CreateEnv)(int log_level, const char *log_name, OrtEnv **env);
    OrtUnused unused_4[4];
    OrtStatus *(*CreateSessionFromArray)(const OrtEnv *env, const void *model, size_t size,
                                         const OrtSessionOptions *options, OrtSession **session);
    OrtStatus *(*Run)(OrtSession *session, const OrtRunOptions *options,
                      const char *const *input_names, const OrtValue *const *inputs,
                      size_t num_inputs, const char *const *output_names, size_t num_outputs,
                      OrtValue **outputs); /* fills those that are there, makes those NULL */
    OrtStatus *(*CreateSessionOptions)(OrtSessionOptions **options);
    OrtUnused unused_11[13];
    OrtStatus *(*SetIntraOpNumThreads)(OrtSessionOptions *options, int num_threads);
    OrtUnused unused_25[24];
    OrtStatus *(*CreateTensorWithDataAsOrtValue)(const OrtMemoryInfo *memory, void *data,
                                                 size_t size, const int64_t *shape, size_t num_axes,
                                                 int type, OrtValue **value);
    OrtUnused unused_50[19];
    OrtStatus *(*CreateCpuMemoryInfo)(int allocator, int kind, OrtMemoryInfo **memory);
    OrtUnused unused_70[22];
    void (*ReleaseEnv)(OrtEnv *env);
    void (*ReleaseStatus)(OrtStatus *status);
    void (*ReleaseMemoryInfo)(OrtMemoryInfo *memory);
    void (*ReleaseSession)(OrtSession *session);
    void (*ReleaseValue)(OrtValue *value);
    OrtUnused unused_97[3];
    void (*ReleaseSessionOptions)(OrtSessionOptions *options);
} OrtApi;

#define ORT_PLACE(function) (offsetof(OrtApi, function) / sizeof(OrtUnused))
_Static_assert(ORT_PLACE(CreateSessionFromArray) == 8 && ORT_PLACE(Run) == 9, "table");
_Static_assert(ORT_PLACE(SetIntraOpNumThreads) == 24, "table");
_Static_assert(ORT_PLACE(CreateTensorWithDataAsOrtValue) == 49, "table");
_Static_assert(ORT_PLACE(CreateCpuMemoryInfo) == 69, "table");
_Static_assert(ORT_PLACE(ReleaseEnv) == 92 && ORT_PLACE(ReleaseSessionOptions) == 100, "table");

typedef struct OrtApiBase {
    const OrtApi *(*GetApi)(uint32_t version); /* NULL if the library is older */
    const char *(*GetVersionString)(void);
} OrtApiBase;

const OrtApiBase *OrtGetApiBase(void);

#endif
